"""What is observed: tracked points with their places on the organ, the rigid motion that fits them, the visible share."""
