"""The frozen reference policy and its SAC training."""
