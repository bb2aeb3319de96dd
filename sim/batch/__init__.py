"""Many runs of the twin in one process."""
