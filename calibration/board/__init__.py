"""Detection of a calibration target in an image, and subpixel location of its corners."""
