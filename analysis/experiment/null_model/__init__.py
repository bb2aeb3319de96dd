"""A session of one direction against a model of identical modules."""
