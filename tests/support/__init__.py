"""What tests share: builders of sessions, robots and buses, processes, a browser."""
