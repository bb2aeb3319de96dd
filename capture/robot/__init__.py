"""What a robot is: its model, its description file, and where its links are."""
