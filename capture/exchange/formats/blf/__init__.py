"""Vector BLF: binary traces of CAN buses."""
