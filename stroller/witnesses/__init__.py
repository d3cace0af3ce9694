"""The stroller in coordinates: an independent description, with poles, of what the vector form has without them."""
