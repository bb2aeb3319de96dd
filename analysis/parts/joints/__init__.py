"""One row a joint: what is measured of it."""
