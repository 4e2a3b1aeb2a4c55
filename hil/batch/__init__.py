"""Re-identification from any number of archives, by arm and campaign."""
