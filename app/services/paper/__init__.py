"""Text for the paper and its preregistration"""
