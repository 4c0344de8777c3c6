"""Is an installed site still where it was?"""
