"""The phantom experiment: markers inside an organ, whose deformed surface was observed."""
