"""Where methods are tried: virtual patients, a benchmark of predictors, error against run time."""
