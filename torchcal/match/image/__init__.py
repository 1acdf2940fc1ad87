"""Elements of range images (3.1 (2)): planes, lines and vertexes with their covariances."""
