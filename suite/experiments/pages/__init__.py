"""What a document shows: its page, tables, charts, and what the paper prints."""
