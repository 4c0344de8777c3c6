"""Studies made with retropole, each a folder and a command of a clone; no part of the package."""
