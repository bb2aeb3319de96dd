"""Many runs of the twin over a design of parameters, each one row of results."""
