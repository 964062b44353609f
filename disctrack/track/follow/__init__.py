"""The disc followed through blocks of image pairs."""
