"""Changes of an arm between campaigns, and their page."""
