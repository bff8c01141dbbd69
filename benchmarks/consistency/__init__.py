"""Whether stated covariances agree with the errors: NEES of drawn and driven robots, tuned noise, predictions."""
