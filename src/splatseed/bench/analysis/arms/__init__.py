"""Arms of any seeds and any strategy beside one another, and what advice picks among them."""
