"""The twin: stepped, recorded, or as a source of the recorder; adaptive control of its gait."""
