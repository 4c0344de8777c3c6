"""The planar surfaces of Jiao et al. 2019: a rival that finds the pose of two clouds by planes."""
