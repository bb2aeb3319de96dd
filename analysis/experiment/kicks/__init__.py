"""Coupling around one gait, from kicks of single joints."""
