"""The commands that analyse, compare, plan, predict and report."""
