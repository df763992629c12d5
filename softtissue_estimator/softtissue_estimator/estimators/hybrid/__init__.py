"""The elastic posterior and a network that says what it leaves and how sure it is."""
