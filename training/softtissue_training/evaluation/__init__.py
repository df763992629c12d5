"""How far estimators are off: cases with a known truth, estimators that answer them, measures and reports."""
