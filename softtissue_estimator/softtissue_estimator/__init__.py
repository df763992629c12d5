"""Real-time soft-tissue navigation: where the inside of an organ is now, from an observation of its surface."""
