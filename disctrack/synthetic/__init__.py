"""Synthetic recordings with known truth: images of the two cameras, including photon noise and quantisation.

cameras (true rig, board poses) -> optics (rays, blur, lamp, noise, quantisation), _raster_kernel (shapes)
-> images (disc, chessboard) -> recording (folder) and truth (truth.h5).
It shares no code with the location of markers and corners, and so is an independent test of these.
"""
