"""Everything that answers an observation, behind one interface (`estimator`); a package for each."""
