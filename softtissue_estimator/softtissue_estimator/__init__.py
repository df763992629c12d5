"""Real-time soft-tissue navigation: where the inside of an organ is now, from what is seen of its surface."""
