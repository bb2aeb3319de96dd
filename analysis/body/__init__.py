"""Head, middle and tail in the plane, and how they would move with perfectly tracking joints."""
