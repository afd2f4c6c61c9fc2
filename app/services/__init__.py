"""What people can do, one function each, in one transaction."""
