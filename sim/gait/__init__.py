"""Gaits: what the joints are commanded to do. :mod:`.sim.gait.contract` says what each offers."""
