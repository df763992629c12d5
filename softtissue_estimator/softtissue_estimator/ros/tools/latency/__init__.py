"""The whole way from a cloud on the wire to an answer on the wire, measured through real processes."""
