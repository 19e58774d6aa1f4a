"""Parts of step 3: its checks, chunks, dask DataFrames, products kept, predictions ahead."""
