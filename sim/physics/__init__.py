"""The twin's physics: engines, ground contact, servos and the energy ledger."""
