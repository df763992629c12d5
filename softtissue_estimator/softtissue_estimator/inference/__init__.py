"""Where and in what format estimators compute: devices, precision, prepared networks."""
