"""What an object is made of in space: mesh, signed distances, collision parts, soft lattice."""
