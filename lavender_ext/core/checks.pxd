"""Creation of objects for other modules."""

cpdef make_instance(cls, dict attributes)
