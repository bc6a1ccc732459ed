"""Machine files, magnetics and what is derived from them."""
