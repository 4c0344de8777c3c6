"""Thousands of sites: all calibrated, adjusted as one network, and watched over time.

`batch.calibrate_fleet` is the first on one page: sites (`sites`), one after the other on the
workers of a Dask cluster (`engine`), each in a process that can be ended (`process`, and `work`
within), rows into a partitioned Parquet dataset (`dataset`), on any file system (`storage`).
`network` adjusts relative poses of many sites together, `history` watches every site's checks.
"""

TIME_LIMIT = 900.0
"""Seconds for one site: a pair of 100,000 points takes seconds, twelve LiDARs take minutes."""
