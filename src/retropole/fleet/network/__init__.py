"""The network of a city: poses that many sites share, adjusted together."""
