"""Message types, their encoding, and raw CAN frames."""

# Here, since the help of most commands shows them: importing the definitions takes longer.
COMMAND_TOPIC, RESPONSE_TOPIC = "/joint_commands", "/joint_states"
"""Topics of the log contract for commanded and measured joints."""
