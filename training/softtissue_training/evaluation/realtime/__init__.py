"""`make bench`: every stage alone and the whole path through real processes, beside what it replaces."""
