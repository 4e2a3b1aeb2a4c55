"""What an identified model is good for, from held-out motion and the covariance."""
