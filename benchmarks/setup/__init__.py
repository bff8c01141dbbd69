"""Station frames and calibration: what is found, how small a movement is noticed, what estimates of others are worth."""
