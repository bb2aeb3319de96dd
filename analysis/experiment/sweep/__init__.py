"""Linear coupling of a chain without contact, from lag sweeps and multisines."""
