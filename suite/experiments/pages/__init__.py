"""Result pages of docs/results: writing a page, its tables and charts, and the paper's numbers."""
