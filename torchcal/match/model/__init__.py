"""Elements of the model: planes, lines and vertexes of meshes, and which of them are visible."""
