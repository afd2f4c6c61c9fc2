"""The frozen reference policy, trained by SAC."""
