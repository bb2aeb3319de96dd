"""Many sessions of a robot over weeks: change points, variance components, outliers."""
