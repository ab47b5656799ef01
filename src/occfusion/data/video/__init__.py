"""One's own footage, in the form that PeopleSnapshot and NeuMan have come to."""
