"""Results for people: text, tables, pictures, pages."""
