"""The field's yearly competition: its twelve plants, its instances, and what is decided of them."""
