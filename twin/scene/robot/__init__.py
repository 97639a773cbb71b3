"""The robot in a scan: kept out of the background, kept as Gaussians on its links."""
