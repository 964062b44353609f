"""Synthetic recordings with known truth: what the two cameras would see, down to photons and quantisation.

cameras (true rig, board poses) -> optics (rays, blur, lamp), raster (shapes) -> sensor (noise, numbers)
-> images (disc, chessboard) -> recording (folder) and truth (truth.h5).
It shares no code with the location of markers and corners, so that those can be judged by it.
"""
