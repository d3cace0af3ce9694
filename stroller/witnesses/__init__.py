"""The stroller in coordinates: an independent description, with coordinate singularities that the vector form does not
have."""
