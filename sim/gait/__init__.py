"""Gaits: commands of the joints over time.

:mod:`.sim.gait.contract` defines their interface.
"""
