"""What is trusted: the recheck and its certificates; proposals and witnesses beside them."""
