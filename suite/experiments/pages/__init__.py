"""Result pages: the page, tables, charts, and the paper's printed numbers."""
