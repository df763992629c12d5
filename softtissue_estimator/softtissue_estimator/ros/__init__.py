"""Everything of the estimator that touches ROS."""
