"""Motion without commands: of animals, of robots whose commands were not logged."""
