"""Questions to a scene and their answers: rides, tables, crossings, pictures and pages."""
