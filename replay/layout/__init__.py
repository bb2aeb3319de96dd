"""Views and tabs of the viewer."""
