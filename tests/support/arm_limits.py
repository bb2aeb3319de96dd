"""The limits of the arm joint that answers requests, as its description has them."""

ARM_LIMITS = """
[safety]
max_rate = 4.0
ramp_rate = 1.0
max_tracking_error = 0.5
max_current = 5.0
max_temperature = 60.0
reply_timeout_s = 0.25
max_late_s = 0.5
"""
