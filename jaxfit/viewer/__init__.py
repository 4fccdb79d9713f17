"""The viewer: film, birds on their ledge, timeline and corrections in a page of the browser."""
