"""Which dots, poses and declarations are to be believed."""
