"""Published studies as code: tasks with seeds, stored one by one, and the tables and figures made of them."""
