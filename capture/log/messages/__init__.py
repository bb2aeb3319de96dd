"""Message types, their encoding, and raw CAN frames."""
