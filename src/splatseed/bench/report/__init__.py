"""The report: figures, pictures and the page that holds them."""
