"""How good twin and policies are on episodes that no training has drawn."""
