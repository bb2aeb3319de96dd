"""Best linear approximations from several sessions of one multisine experiment."""
