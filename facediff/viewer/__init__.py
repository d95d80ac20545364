"""One HTML file that plays takes in any browser."""
