"""The elastic posterior: a Gaussian process whose covariance is the elasticity of the deformed organ."""
