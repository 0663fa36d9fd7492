"""The HTTP face: a STAC API over the catalogue, pages for people, blobs, uploads, figures for the operator."""
