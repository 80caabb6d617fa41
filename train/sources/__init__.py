"""Published datasets: G-Objaverse, Objaverse, GSO; and packs of decoded views."""
