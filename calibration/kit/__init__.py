"""What all modules of both packages use: array types, errors, least squares, short views, grey and stuck pixels."""
