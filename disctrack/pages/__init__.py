"""What people read: pages of HTML that need no other file, figures, and the colours of both. Written once, for all."""
