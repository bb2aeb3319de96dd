"""The safety gate: what stands between whoever drives and a robot's bus."""
