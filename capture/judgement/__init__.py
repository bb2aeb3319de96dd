"""Which joints of a session don't follow their command, which changed, and what else differs."""
