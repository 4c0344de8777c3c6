"""How far real scenes lead the refinement from the reference, and what becomes of planted poles.

Prints three Markdown tables. From the reference of every real pair, with a prior so wide that it
holds nothing: how far poles-and-scene refinement, point-to-plane ICP and GICP go (small_gicp, each
at the best and at the worst of four settings), which share of the information on each direction the
most decisive place holds, what is stated, and the Mahalanobis distance with the reference's own
error added. Three frames of one standing vehicle against each other. And poles ray-cast into every
pair (as `semireal.py` does): what is answered, how far off at 30 m, and how honest.

Pairs of pjlab_0003 and pandar_0001 tune, those of pandar_scene1, pandaset and planes_top_front
state the figures; seeds of planted poles below 1000 tune, those from 1000 on state.

    python benchmarks/real.py data --draws 8 --first 1000
"""
