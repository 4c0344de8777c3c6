"""Is a transform still right, is it as accurate as it says, and how do other methods do?"""
