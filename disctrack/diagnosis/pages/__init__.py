"""What a diagnosis says: words, JSON, figures and the page."""
