	.file	"<string>"
	.section	.ltext,"axl",@progbits
	.globl	_ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE
	.p2align	4
	.type	_ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE,@function
_ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE:
	pushq	%rbp
	pushq	%r15
	pushq	%r14
	pushq	%r13
	pushq	%r12
	pushq	%rbx
	cmpq	$0, 152(%rsp)
	movq	%rdi, -8(%rsp)
	jle	.LBB0_5
	movq	80(%rsp), %rbx
	movq	216(%rsp), %rcx
	movq	64(%rsp), %r10
	movq	56(%rsp), %r11
	xorl	%r14d, %r14d
	imulq	72(%rsp), %rbx
	.p2align	4
.LBB0_2:
	movq	%r14, %rax
	imulq	160(%rsp), %rax
	movq	144(%rsp), %rdx
	movq	72(%rsp), %r9
	movq	80(%rsp), %r8
	movl	$0, %esi
	movq	8(%rdx,%rax,8), %r15
	movq	16(%rdx,%rax,8), %rax
	movl	$0, %edx
	movq	%rax, %r12
	sarq	$63, %r12
	andq	%r9, %r12
	addq	%rax, %r12
	imulq	%r8, %r12
	cmpq	$-1, %rax
	cmovlq	%r9, %rdx
	leaq	1(%rax,%rdx), %r13
	movl	$0, %edx
	imulq	%r8, %r13
	cmpq	$-2, %rax
	cmovlq	%r9, %rdx
	leaq	2(%rax,%rdx), %rbp
	movl	$0, %edx
	imulq	%r8, %rbp
	cmpq	$-3, %rax
	cmovlq	%r9, %rdx
	leaq	3(%rax,%rdx), %rdx
	imulq	%r8, %rdx
	cmpq	$-4, %rax
	cmovlq	%r9, %rsi
	leaq	4(%rax,%rsi), %rdi
	movl	$0, %esi
	imulq	%r8, %rdi
	cmpq	$-5, %rax
	cmovlq	%r9, %rsi
	leaq	5(%rax,%rsi), %rax
	xorl	%esi, %esi
	imulq	%r8, %rax
	.p2align	4
.LBB0_3:
	leaq	(%rsi,%r15), %r8
	movq	%r8, %r9
	sarq	$63, %r9
	andq	%r10, %r9
	addq	%r8, %r9
	leaq	(%rsi,%rsi,2), %r8
	incq	%rsi
	imulq	%rbx, %r9
	shlq	$9, %r8
	leaq	(%r11,%r9,4), %r9
	vmovss	(%r9,%r12,4), %xmm0
	vmovss	%xmm0, (%rcx,%r8)
	vmovss	4(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 4(%rcx,%r8)
	vmovss	8(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 8(%rcx,%r8)
	vmovss	12(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 12(%rcx,%r8)
	vmovss	16(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 16(%rcx,%r8)
	vmovss	20(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 20(%rcx,%r8)
	vmovss	24(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 24(%rcx,%r8)
	vmovss	28(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 28(%rcx,%r8)
	vmovss	32(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 32(%rcx,%r8)
	vmovss	36(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 36(%rcx,%r8)
	vmovss	40(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 40(%rcx,%r8)
	vmovss	44(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 44(%rcx,%r8)
	vmovss	48(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 48(%rcx,%r8)
	vmovss	52(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 52(%rcx,%r8)
	vmovss	56(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 56(%rcx,%r8)
	vmovss	60(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 60(%rcx,%r8)
	vmovss	64(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 64(%rcx,%r8)
	vmovss	68(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 68(%rcx,%r8)
	vmovss	72(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 72(%rcx,%r8)
	vmovss	76(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 76(%rcx,%r8)
	vmovss	80(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 80(%rcx,%r8)
	vmovss	84(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 84(%rcx,%r8)
	vmovss	88(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 88(%rcx,%r8)
	vmovss	92(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 92(%rcx,%r8)
	vmovss	96(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 96(%rcx,%r8)
	vmovss	100(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 100(%rcx,%r8)
	vmovss	104(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 104(%rcx,%r8)
	vmovss	108(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 108(%rcx,%r8)
	vmovss	112(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 112(%rcx,%r8)
	vmovss	116(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 116(%rcx,%r8)
	vmovss	120(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 120(%rcx,%r8)
	vmovss	124(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 124(%rcx,%r8)
	vmovss	128(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 128(%rcx,%r8)
	vmovss	132(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 132(%rcx,%r8)
	vmovss	136(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 136(%rcx,%r8)
	vmovss	140(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 140(%rcx,%r8)
	vmovss	144(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 144(%rcx,%r8)
	vmovss	148(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 148(%rcx,%r8)
	vmovss	152(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 152(%rcx,%r8)
	vmovss	156(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 156(%rcx,%r8)
	vmovss	160(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 160(%rcx,%r8)
	vmovss	164(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 164(%rcx,%r8)
	vmovss	168(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 168(%rcx,%r8)
	vmovss	172(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 172(%rcx,%r8)
	vmovss	176(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 176(%rcx,%r8)
	vmovss	180(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 180(%rcx,%r8)
	vmovss	184(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 184(%rcx,%r8)
	vmovss	188(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 188(%rcx,%r8)
	vmovss	192(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 192(%rcx,%r8)
	vmovss	196(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 196(%rcx,%r8)
	vmovss	200(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 200(%rcx,%r8)
	vmovss	204(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 204(%rcx,%r8)
	vmovss	208(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 208(%rcx,%r8)
	vmovss	212(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 212(%rcx,%r8)
	vmovss	216(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 216(%rcx,%r8)
	vmovss	220(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 220(%rcx,%r8)
	vmovss	224(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 224(%rcx,%r8)
	vmovss	228(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 228(%rcx,%r8)
	vmovss	232(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 232(%rcx,%r8)
	vmovss	236(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 236(%rcx,%r8)
	vmovss	240(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 240(%rcx,%r8)
	vmovss	244(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 244(%rcx,%r8)
	vmovss	248(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 248(%rcx,%r8)
	vmovss	252(%r9,%r12,4), %xmm0
	vmovss	%xmm0, 252(%rcx,%r8)
	vmovss	(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 256(%rcx,%r8)
	vmovss	4(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 260(%rcx,%r8)
	vmovss	8(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 264(%rcx,%r8)
	vmovss	12(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 268(%rcx,%r8)
	vmovss	16(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 272(%rcx,%r8)
	vmovss	20(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 276(%rcx,%r8)
	vmovss	24(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 280(%rcx,%r8)
	vmovss	28(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 284(%rcx,%r8)
	vmovss	32(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 288(%rcx,%r8)
	vmovss	36(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 292(%rcx,%r8)
	vmovss	40(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 296(%rcx,%r8)
	vmovss	44(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 300(%rcx,%r8)
	vmovss	48(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 304(%rcx,%r8)
	vmovss	52(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 308(%rcx,%r8)
	vmovss	56(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 312(%rcx,%r8)
	vmovss	60(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 316(%rcx,%r8)
	vmovss	64(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 320(%rcx,%r8)
	vmovss	68(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 324(%rcx,%r8)
	vmovss	72(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 328(%rcx,%r8)
	vmovss	76(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 332(%rcx,%r8)
	vmovss	80(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 336(%rcx,%r8)
	vmovss	84(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 340(%rcx,%r8)
	vmovss	88(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 344(%rcx,%r8)
	vmovss	92(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 348(%rcx,%r8)
	vmovss	96(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 352(%rcx,%r8)
	vmovss	100(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 356(%rcx,%r8)
	vmovss	104(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 360(%rcx,%r8)
	vmovss	108(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 364(%rcx,%r8)
	vmovss	112(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 368(%rcx,%r8)
	vmovss	116(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 372(%rcx,%r8)
	vmovss	120(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 376(%rcx,%r8)
	vmovss	124(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 380(%rcx,%r8)
	vmovss	128(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 384(%rcx,%r8)
	vmovss	132(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 388(%rcx,%r8)
	vmovss	136(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 392(%rcx,%r8)
	vmovss	140(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 396(%rcx,%r8)
	vmovss	144(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 400(%rcx,%r8)
	vmovss	148(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 404(%rcx,%r8)
	vmovss	152(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 408(%rcx,%r8)
	vmovss	156(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 412(%rcx,%r8)
	vmovss	160(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 416(%rcx,%r8)
	vmovss	164(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 420(%rcx,%r8)
	vmovss	168(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 424(%rcx,%r8)
	vmovss	172(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 428(%rcx,%r8)
	vmovss	176(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 432(%rcx,%r8)
	vmovss	180(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 436(%rcx,%r8)
	vmovss	184(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 440(%rcx,%r8)
	vmovss	188(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 444(%rcx,%r8)
	vmovss	192(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 448(%rcx,%r8)
	vmovss	196(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 452(%rcx,%r8)
	vmovss	200(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 456(%rcx,%r8)
	vmovss	204(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 460(%rcx,%r8)
	vmovss	208(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 464(%rcx,%r8)
	vmovss	212(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 468(%rcx,%r8)
	vmovss	216(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 472(%rcx,%r8)
	vmovss	220(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 476(%rcx,%r8)
	vmovss	224(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 480(%rcx,%r8)
	vmovss	228(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 484(%rcx,%r8)
	vmovss	232(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 488(%rcx,%r8)
	vmovss	236(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 492(%rcx,%r8)
	vmovss	240(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 496(%rcx,%r8)
	vmovss	244(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 500(%rcx,%r8)
	vmovss	248(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 504(%rcx,%r8)
	vmovss	252(%r9,%r13,4), %xmm0
	vmovss	%xmm0, 508(%rcx,%r8)
	vmovss	(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 512(%rcx,%r8)
	vmovss	4(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 516(%rcx,%r8)
	vmovss	8(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 520(%rcx,%r8)
	vmovss	12(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 524(%rcx,%r8)
	vmovss	16(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 528(%rcx,%r8)
	vmovss	20(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 532(%rcx,%r8)
	vmovss	24(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 536(%rcx,%r8)
	vmovss	28(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 540(%rcx,%r8)
	vmovss	32(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 544(%rcx,%r8)
	vmovss	36(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 548(%rcx,%r8)
	vmovss	40(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 552(%rcx,%r8)
	vmovss	44(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 556(%rcx,%r8)
	vmovss	48(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 560(%rcx,%r8)
	vmovss	52(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 564(%rcx,%r8)
	vmovss	56(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 568(%rcx,%r8)
	vmovss	60(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 572(%rcx,%r8)
	vmovss	64(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 576(%rcx,%r8)
	vmovss	68(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 580(%rcx,%r8)
	vmovss	72(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 584(%rcx,%r8)
	vmovss	76(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 588(%rcx,%r8)
	vmovss	80(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 592(%rcx,%r8)
	vmovss	84(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 596(%rcx,%r8)
	vmovss	88(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 600(%rcx,%r8)
	vmovss	92(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 604(%rcx,%r8)
	vmovss	96(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 608(%rcx,%r8)
	vmovss	100(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 612(%rcx,%r8)
	vmovss	104(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 616(%rcx,%r8)
	vmovss	108(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 620(%rcx,%r8)
	vmovss	112(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 624(%rcx,%r8)
	vmovss	116(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 628(%rcx,%r8)
	vmovss	120(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 632(%rcx,%r8)
	vmovss	124(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 636(%rcx,%r8)
	vmovss	128(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 640(%rcx,%r8)
	vmovss	132(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 644(%rcx,%r8)
	vmovss	136(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 648(%rcx,%r8)
	vmovss	140(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 652(%rcx,%r8)
	vmovss	144(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 656(%rcx,%r8)
	vmovss	148(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 660(%rcx,%r8)
	vmovss	152(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 664(%rcx,%r8)
	vmovss	156(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 668(%rcx,%r8)
	vmovss	160(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 672(%rcx,%r8)
	vmovss	164(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 676(%rcx,%r8)
	vmovss	168(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 680(%rcx,%r8)
	vmovss	172(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 684(%rcx,%r8)
	vmovss	176(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 688(%rcx,%r8)
	vmovss	180(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 692(%rcx,%r8)
	vmovss	184(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 696(%rcx,%r8)
	vmovss	188(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 700(%rcx,%r8)
	vmovss	192(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 704(%rcx,%r8)
	vmovss	196(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 708(%rcx,%r8)
	vmovss	200(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 712(%rcx,%r8)
	vmovss	204(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 716(%rcx,%r8)
	vmovss	208(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 720(%rcx,%r8)
	vmovss	212(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 724(%rcx,%r8)
	vmovss	216(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 728(%rcx,%r8)
	vmovss	220(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 732(%rcx,%r8)
	vmovss	224(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 736(%rcx,%r8)
	vmovss	228(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 740(%rcx,%r8)
	vmovss	232(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 744(%rcx,%r8)
	vmovss	236(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 748(%rcx,%r8)
	vmovss	240(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 752(%rcx,%r8)
	vmovss	244(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 756(%rcx,%r8)
	vmovss	248(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 760(%rcx,%r8)
	vmovss	252(%r9,%rbp,4), %xmm0
	vmovss	%xmm0, 764(%rcx,%r8)
	vmovss	(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 768(%rcx,%r8)
	vmovss	4(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 772(%rcx,%r8)
	vmovss	8(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 776(%rcx,%r8)
	vmovss	12(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 780(%rcx,%r8)
	vmovss	16(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 784(%rcx,%r8)
	vmovss	20(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 788(%rcx,%r8)
	vmovss	24(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 792(%rcx,%r8)
	vmovss	28(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 796(%rcx,%r8)
	vmovss	32(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 800(%rcx,%r8)
	vmovss	36(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 804(%rcx,%r8)
	vmovss	40(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 808(%rcx,%r8)
	vmovss	44(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 812(%rcx,%r8)
	vmovss	48(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 816(%rcx,%r8)
	vmovss	52(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 820(%rcx,%r8)
	vmovss	56(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 824(%rcx,%r8)
	vmovss	60(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 828(%rcx,%r8)
	vmovss	64(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 832(%rcx,%r8)
	vmovss	68(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 836(%rcx,%r8)
	vmovss	72(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 840(%rcx,%r8)
	vmovss	76(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 844(%rcx,%r8)
	vmovss	80(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 848(%rcx,%r8)
	vmovss	84(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 852(%rcx,%r8)
	vmovss	88(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 856(%rcx,%r8)
	vmovss	92(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 860(%rcx,%r8)
	vmovss	96(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 864(%rcx,%r8)
	vmovss	100(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 868(%rcx,%r8)
	vmovss	104(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 872(%rcx,%r8)
	vmovss	108(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 876(%rcx,%r8)
	vmovss	112(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 880(%rcx,%r8)
	vmovss	116(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 884(%rcx,%r8)
	vmovss	120(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 888(%rcx,%r8)
	vmovss	124(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 892(%rcx,%r8)
	vmovss	128(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 896(%rcx,%r8)
	vmovss	132(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 900(%rcx,%r8)
	vmovss	136(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 904(%rcx,%r8)
	vmovss	140(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 908(%rcx,%r8)
	vmovss	144(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 912(%rcx,%r8)
	vmovss	148(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 916(%rcx,%r8)
	vmovss	152(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 920(%rcx,%r8)
	vmovss	156(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 924(%rcx,%r8)
	vmovss	160(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 928(%rcx,%r8)
	vmovss	164(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 932(%rcx,%r8)
	vmovss	168(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 936(%rcx,%r8)
	vmovss	172(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 940(%rcx,%r8)
	vmovss	176(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 944(%rcx,%r8)
	vmovss	180(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 948(%rcx,%r8)
	vmovss	184(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 952(%rcx,%r8)
	vmovss	188(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 956(%rcx,%r8)
	vmovss	192(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 960(%rcx,%r8)
	vmovss	196(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 964(%rcx,%r8)
	vmovss	200(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 968(%rcx,%r8)
	vmovss	204(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 972(%rcx,%r8)
	vmovss	208(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 976(%rcx,%r8)
	vmovss	212(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 980(%rcx,%r8)
	vmovss	216(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 984(%rcx,%r8)
	vmovss	220(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 988(%rcx,%r8)
	vmovss	224(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 992(%rcx,%r8)
	vmovss	228(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 996(%rcx,%r8)
	vmovss	232(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 1000(%rcx,%r8)
	vmovss	236(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 1004(%rcx,%r8)
	vmovss	240(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 1008(%rcx,%r8)
	vmovss	244(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 1012(%rcx,%r8)
	vmovss	248(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 1016(%rcx,%r8)
	vmovss	252(%r9,%rdx,4), %xmm0
	vmovss	%xmm0, 1020(%rcx,%r8)
	vmovss	(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1024(%rcx,%r8)
	vmovss	4(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1028(%rcx,%r8)
	vmovss	8(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1032(%rcx,%r8)
	vmovss	12(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1036(%rcx,%r8)
	vmovss	16(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1040(%rcx,%r8)
	vmovss	20(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1044(%rcx,%r8)
	vmovss	24(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1048(%rcx,%r8)
	vmovss	28(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1052(%rcx,%r8)
	vmovss	32(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1056(%rcx,%r8)
	vmovss	36(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1060(%rcx,%r8)
	vmovss	40(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1064(%rcx,%r8)
	vmovss	44(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1068(%rcx,%r8)
	vmovss	48(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1072(%rcx,%r8)
	vmovss	52(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1076(%rcx,%r8)
	vmovss	56(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1080(%rcx,%r8)
	vmovss	60(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1084(%rcx,%r8)
	vmovss	64(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1088(%rcx,%r8)
	vmovss	68(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1092(%rcx,%r8)
	vmovss	72(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1096(%rcx,%r8)
	vmovss	76(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1100(%rcx,%r8)
	vmovss	80(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1104(%rcx,%r8)
	vmovss	84(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1108(%rcx,%r8)
	vmovss	88(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1112(%rcx,%r8)
	vmovss	92(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1116(%rcx,%r8)
	vmovss	96(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1120(%rcx,%r8)
	vmovss	100(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1124(%rcx,%r8)
	vmovss	104(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1128(%rcx,%r8)
	vmovss	108(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1132(%rcx,%r8)
	vmovss	112(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1136(%rcx,%r8)
	vmovss	116(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1140(%rcx,%r8)
	vmovss	120(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1144(%rcx,%r8)
	vmovss	124(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1148(%rcx,%r8)
	vmovss	128(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1152(%rcx,%r8)
	vmovss	132(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1156(%rcx,%r8)
	vmovss	136(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1160(%rcx,%r8)
	vmovss	140(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1164(%rcx,%r8)
	vmovss	144(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1168(%rcx,%r8)
	vmovss	148(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1172(%rcx,%r8)
	vmovss	152(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1176(%rcx,%r8)
	vmovss	156(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1180(%rcx,%r8)
	vmovss	160(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1184(%rcx,%r8)
	vmovss	164(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1188(%rcx,%r8)
	vmovss	168(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1192(%rcx,%r8)
	vmovss	172(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1196(%rcx,%r8)
	vmovss	176(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1200(%rcx,%r8)
	vmovss	180(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1204(%rcx,%r8)
	vmovss	184(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1208(%rcx,%r8)
	vmovss	188(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1212(%rcx,%r8)
	vmovss	192(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1216(%rcx,%r8)
	vmovss	196(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1220(%rcx,%r8)
	vmovss	200(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1224(%rcx,%r8)
	vmovss	204(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1228(%rcx,%r8)
	vmovss	208(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1232(%rcx,%r8)
	vmovss	212(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1236(%rcx,%r8)
	vmovss	216(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1240(%rcx,%r8)
	vmovss	220(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1244(%rcx,%r8)
	vmovss	224(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1248(%rcx,%r8)
	vmovss	228(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1252(%rcx,%r8)
	vmovss	232(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1256(%rcx,%r8)
	vmovss	236(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1260(%rcx,%r8)
	vmovss	240(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1264(%rcx,%r8)
	vmovss	244(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1268(%rcx,%r8)
	vmovss	248(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1272(%rcx,%r8)
	vmovss	252(%r9,%rdi,4), %xmm0
	vmovss	%xmm0, 1276(%rcx,%r8)
	vmovss	(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1280(%rcx,%r8)
	vmovss	4(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1284(%rcx,%r8)
	vmovss	8(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1288(%rcx,%r8)
	vmovss	12(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1292(%rcx,%r8)
	vmovss	16(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1296(%rcx,%r8)
	vmovss	20(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1300(%rcx,%r8)
	vmovss	24(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1304(%rcx,%r8)
	vmovss	28(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1308(%rcx,%r8)
	vmovss	32(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1312(%rcx,%r8)
	vmovss	36(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1316(%rcx,%r8)
	vmovss	40(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1320(%rcx,%r8)
	vmovss	44(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1324(%rcx,%r8)
	vmovss	48(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1328(%rcx,%r8)
	vmovss	52(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1332(%rcx,%r8)
	vmovss	56(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1336(%rcx,%r8)
	vmovss	60(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1340(%rcx,%r8)
	vmovss	64(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1344(%rcx,%r8)
	vmovss	68(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1348(%rcx,%r8)
	vmovss	72(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1352(%rcx,%r8)
	vmovss	76(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1356(%rcx,%r8)
	vmovss	80(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1360(%rcx,%r8)
	vmovss	84(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1364(%rcx,%r8)
	vmovss	88(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1368(%rcx,%r8)
	vmovss	92(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1372(%rcx,%r8)
	vmovss	96(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1376(%rcx,%r8)
	vmovss	100(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1380(%rcx,%r8)
	vmovss	104(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1384(%rcx,%r8)
	vmovss	108(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1388(%rcx,%r8)
	vmovss	112(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1392(%rcx,%r8)
	vmovss	116(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1396(%rcx,%r8)
	vmovss	120(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1400(%rcx,%r8)
	vmovss	124(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1404(%rcx,%r8)
	vmovss	128(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1408(%rcx,%r8)
	vmovss	132(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1412(%rcx,%r8)
	vmovss	136(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1416(%rcx,%r8)
	vmovss	140(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1420(%rcx,%r8)
	vmovss	144(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1424(%rcx,%r8)
	vmovss	148(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1428(%rcx,%r8)
	vmovss	152(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1432(%rcx,%r8)
	vmovss	156(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1436(%rcx,%r8)
	vmovss	160(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1440(%rcx,%r8)
	vmovss	164(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1444(%rcx,%r8)
	vmovss	168(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1448(%rcx,%r8)
	vmovss	172(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1452(%rcx,%r8)
	vmovss	176(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1456(%rcx,%r8)
	vmovss	180(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1460(%rcx,%r8)
	vmovss	184(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1464(%rcx,%r8)
	vmovss	188(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1468(%rcx,%r8)
	vmovss	192(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1472(%rcx,%r8)
	vmovss	196(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1476(%rcx,%r8)
	vmovss	200(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1480(%rcx,%r8)
	vmovss	204(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1484(%rcx,%r8)
	vmovss	208(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1488(%rcx,%r8)
	vmovss	212(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1492(%rcx,%r8)
	vmovss	216(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1496(%rcx,%r8)
	vmovss	220(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1500(%rcx,%r8)
	vmovss	224(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1504(%rcx,%r8)
	vmovss	228(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1508(%rcx,%r8)
	vmovss	232(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1512(%rcx,%r8)
	vmovss	236(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1516(%rcx,%r8)
	vmovss	240(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1520(%rcx,%r8)
	vmovss	244(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1524(%rcx,%r8)
	vmovss	248(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1528(%rcx,%r8)
	vmovss	252(%r9,%rax,4), %xmm0
	vmovss	%xmm0, 1532(%rcx,%r8)
	cmpq	$6, %rsi
	jne	.LBB0_3
	incq	%r14
	cmpq	152(%rsp), %r14
	jne	.LBB0_2
.LBB0_5:
	movq	-8(%rsp), %rax
	movq	$0, (%rax)
	xorl	%eax, %eax
	popq	%rbx
	popq	%r12
	popq	%r13
	popq	%r14
	popq	%r15
	popq	%rbp
	retq
.Lfunc_end0:
	.size	_ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE, .Lfunc_end0-_ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE

	.globl	_ZN7cpython8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE
	.p2align	4
	.type	_ZN7cpython8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE,@function
_ZN7cpython8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE:
	.cfi_startproc
	pushq	%rbp
	.cfi_def_cfa_offset 16
	pushq	%r15
	.cfi_def_cfa_offset 24
	pushq	%r14
	.cfi_def_cfa_offset 32
	pushq	%r13
	.cfi_def_cfa_offset 40
	pushq	%r12
	.cfi_def_cfa_offset 48
	pushq	%rbx
	.cfi_def_cfa_offset 56
	subq	$488, %rsp
	.cfi_def_cfa_offset 544
	.cfi_offset %rbx, -56
	.cfi_offset %r12, -48
	.cfi_offset %r13, -40
	.cfi_offset %r14, -32
	.cfi_offset %r15, -24
	.cfi_offset %rbp, -16
	movq	%rsi, %rdi
	leaq	224(%rsp), %rax
	movabsq	$.const.simple, %rsi
	movabsq	$PyArg_UnpackTuple, %r10
	leaq	240(%rsp), %r8
	leaq	232(%rsp), %r9
	movl	$3, %edx
	movl	$3, %ecx
	xorl	%ebx, %ebx
	movq	%rax, (%rsp)
	xorl	%eax, %eax
	callq	*%r10
	testl	%eax, %eax
	je	.LBB1_15
	movabsq	$_ZN08NumbaEnv8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE, %rax
	cmpq	$0, (%rax)
	je	.LBB1_2
	movq	240(%rsp), %rdi
	movabsq	$NRT_adapt_ndarray_from_python, %r15
	leaq	400(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%zmm0, 400(%rsp)
	vmovups	%zmm0, 424(%rsp)
	vzeroupper
	callq	*%r15
	cmpq	$4, 424(%rsp)
	setne	%cl
	testl	%eax, %eax
	setne	%bl
	orb	%cl, %bl
	cmpb	$1, %bl
	je	.LBB1_4
	testb	%bl, %bl
	jne	.LBB1_6
.LBB1_7:
	movq	456(%rsp), %rax
	movq	232(%rsp), %rdi
	movq	400(%rsp), %r14
	movq	432(%rsp), %r12
	movq	440(%rsp), %r13
	movq	448(%rsp), %rbp
	leaq	256(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%zmm0, 256(%rsp)
	movq	$0, 320(%rsp)
	movq	%rax, 216(%rsp)
	vzeroupper
	callq	*%r15
	cmpq	$8, 280(%rsp)
	setne	%cl
	testl	%eax, %eax
	setne	%bl
	orb	%cl, %bl
	jne	.LBB1_8
	testb	%bl, %bl
	jne	.LBB1_13
.LBB1_10:
	movq	256(%rsp), %rax
	movq	224(%rsp), %rdi
	movq	%rbp, 200(%rsp)
	movq	%r13, 208(%rsp)
	movq	288(%rsp), %rbp
	movq	296(%rsp), %rbx
	movq	304(%rsp), %r13
	leaq	336(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 336(%rsp)
	vmovups	%ymm0, 360(%rsp)
	movq	%rax, 184(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_12
	cmpq	$4, 360(%rsp)
	jne	.LBB1_12
	movq	336(%rsp), %rax
	movq	%r14, %r15
	movq	368(%rsp), %r14
	movq	%rax, 192(%rsp)
	movabsq	$PyEval_SaveThread, %rax
	callq	*%rax
	movq	216(%rsp), %rdi
	movq	200(%rsp), %r10
	movq	%r12, %rcx
	movq	%rax, %r12
	movabsq	$_ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE, %rax
	movq	%r14, 160(%rsp)
	movq	%r13, 104(%rsp)
	movq	%rbx, 96(%rsp)
	movq	%rbp, 88(%rsp)
	movq	%rcx, (%rsp)
	movq	%rdi, 24(%rsp)
	movq	208(%rsp), %rdi
	movq	%r10, 16(%rsp)
	movq	%rdi, 8(%rsp)
	leaq	248(%rsp), %rdi
	callq	*%rax
	movabsq	$PyEval_RestoreThread, %rax
	movq	%r12, %rdi
	callq	*%rax
	movabsq	$NRT_decref, %rbx
	movq	%r15, %rdi
	callq	*%rbx
	movq	184(%rsp), %rdi
	callq	*%rbx
	movq	192(%rsp), %rdi
	callq	*%rbx
	movabsq	$_Py_NoneStruct, %rbx
	movabsq	$Py_IncRef, %rax
	movq	%rbx, %rdi
	callq	*%rax
.LBB1_15:
	movq	%rbx, %rax
	addq	$488, %rsp
	.cfi_def_cfa_offset 56
	popq	%rbx
	.cfi_def_cfa_offset 48
	popq	%r12
	.cfi_def_cfa_offset 40
	popq	%r13
	.cfi_def_cfa_offset 32
	popq	%r14
	.cfi_def_cfa_offset 24
	popq	%r15
	.cfi_def_cfa_offset 16
	popq	%rbp
	.cfi_def_cfa_offset 8
	retq
.LBB1_2:
	.cfi_def_cfa_offset 544
	movabsq	$PyExc_RuntimeError, %rdi
	movabsq	$".const.missing Environment: _ZN08NumbaEnv8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	xorl	%ebx, %ebx
	jmp	.LBB1_15
.LBB1_4:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	testb	%bl, %bl
	je	.LBB1_7
.LBB1_6:
	xorl	%ebx, %ebx
	jmp	.LBB1_15
.LBB1_8:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	testb	%bl, %bl
	je	.LBB1_10
	jmp	.LBB1_13
.LBB1_12:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movq	184(%rsp), %rdi
	movabsq	$NRT_decref, %rax
	callq	*%rax
.LBB1_13:
	movabsq	$NRT_decref, %rax
	movq	%r14, %rdi
	callq	*%rax
	xorl	%ebx, %ebx
	jmp	.LBB1_15
.Lfunc_end1:
	.size	_ZN7cpython8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE, .Lfunc_end1-_ZN7cpython8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE
	.cfi_endproc

	.globl	cfunc._ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE
	.p2align	4
	.type	cfunc._ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE,@function
cfunc._ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE:
	subq	$200, %rsp
	vmovaps	208(%rsp), %xmm0
	vmovups	280(%rsp), %xmm1
	movq	296(%rsp), %rax
	movq	352(%rsp), %rcx
	leaq	192(%rsp), %rdi
	movq	$0, 192(%rsp)
	movq	%rax, 104(%rsp)
	movabsq	$_ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE, %rax
	movq	%rcx, 160(%rsp)
	vmovups	%xmm1, 88(%rsp)
	vmovups	%xmm0, 16(%rsp)
	movq	%r9, 8(%rsp)
	movq	%r8, (%rsp)
	callq	*%rax
	movq	192(%rsp), %rax
	addq	$200, %rsp
	retq
.Lfunc_end2:
	.size	cfunc._ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE, .Lfunc_end2-cfunc._ZN8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE

	.weak	NRT_decref
	.p2align	4
	.type	NRT_decref,@function
NRT_decref:
	.cfi_startproc
	testq	%rdi, %rdi
	je	.LBB3_2
	#MEMBARRIER
	lock		decq	(%rdi)
	je	.LBB3_3
.LBB3_2:
	retq
.LBB3_3:
	movabsq	$NRT_MemInfo_call_dtor, %rax
	#MEMBARRIER
	jmpq	*%rax
.Lfunc_end3:
	.size	NRT_decref, .Lfunc_end3-NRT_decref
	.cfi_endproc

	.type	.const.simple,@object
	.section	.lrodata,"al",@progbits
.const.simple:
	.asciz	"simple"
	.size	.const.simple, 7

	.type	_ZN08NumbaEnv8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE,@object
	.comm	_ZN08NumbaEnv8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE,8,8
	.type	".const.missing Environment: _ZN08NumbaEnv8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE",@object
	.p2align	4, 0x0
".const.missing Environment: _ZN08NumbaEnv8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE":
	.asciz	"missing Environment: _ZN08NumbaEnv8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE"
	.size	".const.missing Environment: _ZN08NumbaEnv8__main__6simpleB2v1B92c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAgXrKFt1X1erJ_2bXklRYnJJeo6Cup5xVXqtZrAMC6CmYWUuMAimgA_3dE5ArrayIfLi3E1C7mutable7alignedE5ArrayIxLi2E1C7mutable7alignedE5ArrayIfLi1E1C7mutable7alignedE", 244

	.type	".const.can't unbox array from PyObject into native value.  The object maybe of a different type",@object
	.p2align	4, 0x0
".const.can't unbox array from PyObject into native value.  The object maybe of a different type":
	.asciz	"can't unbox array from PyObject into native value.  The object maybe of a different type"
	.size	".const.can't unbox array from PyObject into native value.  The object maybe of a different type", 89

	.section	".note.GNU-stack","",@progbits
