"""The experiments of the paper (doi 10.5772/57293), one file each, run by `terrabound reproduce`."""
