"""The gaits of a session whose gait changes: where each is constant, and its response."""
