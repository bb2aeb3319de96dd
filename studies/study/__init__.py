"""The study of docs/study.md: from plans to rows, and from rows to the page."""
