"""A page that shows what a file of results holds."""
