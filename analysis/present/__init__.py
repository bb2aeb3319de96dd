"""Results for people: text, tables, pictures, pages, and files that can be read back."""
