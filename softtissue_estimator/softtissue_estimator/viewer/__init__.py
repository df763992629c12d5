"""A live page in a browser: organ, structures, status and distances as the node has them now."""
