"""Where a recording's data come from: CAN buses, other processes, the twin."""
