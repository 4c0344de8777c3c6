"""What ``import retropole as rp`` gives: the steps for users, from paths, arrays or clouds.

`retropole` itself looks the names up when they are used. Nothing is imported here, so that each
name costs only its own module.
"""
