"""The health of a log: measures, findings, verdict."""
