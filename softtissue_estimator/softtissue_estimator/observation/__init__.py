"""What is observed: tracked points with their places on the organ, their rigid motion, the visible share."""
