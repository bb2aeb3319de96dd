"""The commands that record, import, export and edit logs."""
