"""One direction recorded, held to a model of identical modules."""
