"""Reports that are kept in a file until the server has them."""
