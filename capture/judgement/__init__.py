"""The judgement of joints."""
