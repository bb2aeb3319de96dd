"""Energies of joints, cost of transport, and the twin's ledger."""
