"""Couplings of the controller's oscillators, as recorded."""
