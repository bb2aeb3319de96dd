"""The twin: stepped, recorded, or as a source of the recorder."""
